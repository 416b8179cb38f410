"""Invention: how things may look that no scan shows. Only painters read it; no output but colour depends on it."""
