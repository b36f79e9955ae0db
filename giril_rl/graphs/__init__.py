"""A gradient step recorded or compiled as one graph."""
