"""Cloth in a browser page, drawn by viser: a running scene, or a log."""
