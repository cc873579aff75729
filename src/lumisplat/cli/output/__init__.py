"""Output of commands: tables, progress, images, and frames of an animation."""
