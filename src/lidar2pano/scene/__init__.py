"""Belief: what measurement and networks say about a scene. Nothing in here is invented."""
