"""Commands, one a file: a dataclass whose fields are the options, with a method `run`."""
