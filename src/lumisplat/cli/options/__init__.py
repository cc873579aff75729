"""Options that several commands share: base classes of commands, and groups of options."""
