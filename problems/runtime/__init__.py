"""Nodes of distributed algorithms, the messages between them, and the transports that run them."""

from problems.runtime.events import EventSimulation
from problems.runtime.links import Links, Outage, random_outages
from problems.runtime.message import Field, Message, Outgoing, Schema
from problems.runtime.missing import NeighborMemory, Recall
from problems.runtime.node import EventNode, Node, NodeError, NodeFactory, newest_by_sender
from problems.runtime.simulation import Simulation
from problems.runtime.trace import Counters, Trace

__all__ = [
    "Counters",
    "EventNode",
    "EventSimulation",
    "Field",
    "Links",
    "Message",
    "NeighborMemory",
    "Node",
    "NodeError",
    "NodeFactory",
    "Outage",
    "Outgoing",
    "Recall",
    "Schema",
    "Simulation",
    "Trace",
    "newest_by_sender",
    "random_outages",
]
