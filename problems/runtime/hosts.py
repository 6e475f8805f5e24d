"""Where nodes live: in this process, or each in a process of its own behind a pipe."""

from __future__ import annotations

import multiprocessing
import pickle
from collections.abc import Iterable, Mapping
from multiprocessing.connection import Connection
from typing import Any, Protocol

from problems.errors import SettingError
from problems.runtime.node import NodeError, NodeFactory

_ANSWER_SECONDS = 300.0
_CLOSE_SECONDS = 5.0


class Host(Protocol):
    """Starts, calls and stops nodes by index; the only way a simulation touches them."""

    def start(self, nodes: Iterable[int]) -> dict[int, int]:
        """Make fresh nodes; returns their `rounds` (0 for nodes without)."""
        ...

    def stop(self, node: int) -> None:
        """End a node at once; its memory is gone."""
        ...

    def call(self, method: str, arguments: Mapping[int, tuple[Any, ...]]) -> dict[int, Any]:
        """Call one method of several nodes; results by node, in the order of `arguments`."""
        ...

    def close(self) -> None:
        """End all nodes."""
        ...


class LocalHost:
    """Nodes as objects of this process."""

    def __init__(self, make: NodeFactory[Any]) -> None:
        self._make = make
        self._nodes: dict[int, Any] = {}

    def start(self, nodes: Iterable[int]) -> dict[int, int]:
        rounds = {}
        for node in nodes:
            self._nodes[node] = self._make(node)
            rounds[node] = getattr(self._nodes[node], "rounds", 0)
        return rounds

    def stop(self, node: int) -> None:
        del self._nodes[node]

    def call(self, method: str, arguments: Mapping[int, tuple[Any, ...]]) -> dict[int, Any]:
        results: dict[int, Any] = {}
        node = -1
        try:
            for node, given in arguments.items():
                results[node] = _invoke(self._nodes[node], method, given)
        except Exception as error:
            error.add_note(f"in node {node}, {method}")
            raise
        return results

    def close(self) -> None:
        self._nodes.clear()


class ProcessHost:
    """Every node in a process of its own that shares nothing and talks through a pipe.

    Processes come from a fork server (else they are spawned), never from a fork of this process, whose threads and
    locks a child must not inherit. So `make` must be picklable: a function or class of a module, or a
    `functools.partial` of one.

    Raises:
        SettingError: `make` cannot be pickled.
    """

    def __init__(self, make: NodeFactory[Any]) -> None:
        try:
            pickle.dumps(make)
        except Exception as error:
            raise SettingError(
                "nodes in processes need a factory that can be pickled: a function or class of a module, or a "
                f"functools.partial of one ({error})"
            ) from error
        methods = multiprocessing.get_all_start_methods()
        self._context: Any = multiprocessing.get_context("forkserver" if "forkserver" in methods else "spawn")
        self._make = make
        self._children: dict[int, tuple[Any, Connection]] = {}

    def start(self, nodes: Iterable[int]) -> dict[int, int]:
        started = list(nodes)
        for node in started:
            ours, theirs = self._context.Pipe()
            process = self._context.Process(
                target=_serve, args=(self._make, node, theirs), daemon=True, name=f"horizonet-node-{node}"
            )
            process.start()
            theirs.close()
            self._children[node] = process, ours
        return {node: self._receive(node, "start") for node in started}

    def stop(self, node: int) -> None:
        process, connection = self._children.pop(node)
        process.terminate()
        process.join()
        connection.close()

    def call(self, method: str, arguments: Mapping[int, tuple[Any, ...]]) -> dict[int, Any]:
        for node, given in arguments.items():
            try:
                self._children[node][1].send((method, given))
            except (BrokenPipeError, ConnectionError):
                raise self._ended(node, method) from None
        results: dict[int, Any] = {}
        failure: Exception | None = None
        for node in arguments:  # all answers are taken before one is raised, so that the pipes stay in step
            try:
                results[node] = self._receive(node, method)
            except Exception as error:
                failure = failure or error
        if failure is not None:
            raise failure
        return results

    def _receive(self, node: int, method: str) -> Any:
        connection = self._children[node][1]
        try:
            if not connection.poll(_ANSWER_SECONDS):
                raise NodeError(f"node {node} did not answer {method} within {_ANSWER_SECONDS:g} seconds")
            error, result = connection.recv()
        except (EOFError, ConnectionError):
            raise self._ended(node, method) from None
        if error is not None:
            error.add_note(f"in node {node}, {method}; its process said:\n{result}")
            raise error
        return result

    def _ended(self, node: int, method: str) -> NodeError:
        process = self._children[node][0]
        process.join(_CLOSE_SECONDS)
        return NodeError(f"the process of node {node} ended during {method} with exit code {process.exitcode}")

    def close(self) -> None:
        for _, connection in self._children.values():
            try:
                connection.send(None)
            except (BrokenPipeError, ConnectionError):
                continue
        for process, connection in self._children.values():
            process.join(_CLOSE_SECONDS)
            if process.is_alive():
                process.terminate()
                process.join()
            connection.close()
        self._children.clear()


def _serve(make: NodeFactory[Any], index: int, connection: Connection) -> None:
    """Life of one node's process: make the node, then answer calls until told to end."""
    import traceback

    try:
        node = make(index)
        connection.send((None, getattr(node, "rounds", 0)))
    except Exception as error:
        connection.send((_portable(error), traceback.format_exc()))
        return
    while True:
        try:
            request = connection.recv()
        except EOFError:
            return
        if request is None:
            return
        method, given = request
        try:
            connection.send((None, _invoke(node, method, given)))
        except Exception as error:
            connection.send((_portable(error), traceback.format_exc()))


def _invoke(node: Any, method: str, given: tuple[Any, ...]) -> Any:
    result = getattr(node, method)(*given)
    return result if method in ("finish", "output") else tuple(result or ())


def _portable(error: Exception) -> Exception:
    """The exception itself if it survives a pipe, else one that carries its text."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        return NodeError(f"{type(error).__name__}: {error}")
    return error
