"""The only code that touches ports."""
