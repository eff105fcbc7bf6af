"""One module per controller: a codec and a link become a protocol."""
