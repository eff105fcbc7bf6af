"""What to show, and showing it."""
