"""The interactive viewer: a web page to navigate, edit and relight a scene, built on the public API of the package."""
