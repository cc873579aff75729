"""Options that several commands share: as classes that commands derive from, and as groups that they hold."""
