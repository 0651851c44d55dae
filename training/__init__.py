"""Generated shapes, training of the metric of the library, studies of the library, and scripts that run them."""
