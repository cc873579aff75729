"""Path tracing: state and steps of paths, light samples, and contributions."""
