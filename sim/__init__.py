"""A world to put behind the protocols: specimen, optics, motion and wire-level twins."""
