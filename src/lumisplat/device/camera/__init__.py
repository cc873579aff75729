"""Camera models and pixel layouts."""
