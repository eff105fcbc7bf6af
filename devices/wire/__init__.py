"""Pure codecs, one module per controller grammar: bytes in, values out, no I/O."""
