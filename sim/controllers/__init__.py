"""Wire-level twins of real controllers: bytes in, bytes out."""
