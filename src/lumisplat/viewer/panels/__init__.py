"""Control panels beside the image: scene objects, render settings, view options, videos, files and status."""
