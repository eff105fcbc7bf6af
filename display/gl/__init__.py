"""Everything that knows OpenGL: no other package imports moderngl."""
