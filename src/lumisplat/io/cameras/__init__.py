"""Camera files: `transforms.json` and `cameras.json`."""
