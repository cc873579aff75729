"""What commands print and write: tables, progress, pictures, frames of an animation."""
