"""Who may talk to the viewer, and what they may say."""
