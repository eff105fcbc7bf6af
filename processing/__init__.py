"""Pure functions on pictures and volumes, and the pipelines that run them."""
