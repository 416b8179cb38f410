"""The scene that is rendered and scanned: meshes, their materials and classes, and ray casting."""
