"""The viewer: a page in which people fly through a scene, edit it and see it lit; on public names of the package."""
