"""The commands of ``lumisplat``, one module each: a dataclass whose fields are the options, with a method `run`."""
