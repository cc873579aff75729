"""Commands, one per file: a dataclass whose fields are the options, with a method `run`."""
