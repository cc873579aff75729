"""What all formats share: reading what a user named, whole files or none, limits of memory."""
