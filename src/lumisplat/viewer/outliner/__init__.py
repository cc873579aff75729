"""The outliner of scene objects, the properties of the selected one, and how new ones are added."""
