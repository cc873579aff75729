"""The things of the scene beside the picture: their list, the selected one, new ones."""
