"""The operator's console: one window, a client of the instrument process and nothing more."""
