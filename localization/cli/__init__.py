"""Commands of the localization package, registered in ``horizonet.commands``."""
