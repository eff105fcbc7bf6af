"""The console's panels: small functions that draw what the model says and tell it what was done."""
