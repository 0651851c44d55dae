"""File formats that are no triangle meshes, a module each: a file becomes bodies."""
