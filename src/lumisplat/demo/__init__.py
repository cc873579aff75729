"""The demo scene, all of it made by formula."""
