"""What an instrument is made of: protocols, drivers and transports."""
