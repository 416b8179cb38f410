"""The simulated cameras: light, sky, textures and rendering."""
