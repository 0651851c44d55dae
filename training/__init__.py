"""Generated shapes, the training of the library's metric, and studies of the library; thin scripts on top."""
