"""The commands, one a file: options as the fields of a dataclass, and `run`."""
