"""What to take, and taking it: plans, engine, ring, store and journal."""
