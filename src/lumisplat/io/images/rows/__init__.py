"""Pictures written some rows at a time, so that all of one is never in memory."""
