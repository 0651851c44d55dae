"""Studies of the library: what damage and movement do to descriptions, and the figures of the paper."""
