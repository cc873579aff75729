"""What all pages show and edit."""
