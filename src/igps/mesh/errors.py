"""The error of a body that cannot be used."""


class MeshError(ValueError):
    """A mesh cannot be used; the message names the file, what is wrong, and the remedy.

    Example:
        >>> import numpy as np
        >>> from igps import Mesh
        >>> try:
        ...     Mesh(np.zeros((3, 3)), np.array([[0, 1, 5], [0, 2, 5]]))
        ... except MeshError as error:
        ...     print(error)  # names the file, if there is one
        mesh: 2 faces with vertices out of range (0 to 2 exist, 0 to 5 are used). The file is damaged; export it
        again.
    """

    summary = ""
    """What the body is, if errors of this class are counted instead of listed, such as "empty"."""


class NoBodyError(MeshError):
    """The file is sound and holds no body, such as the empty mask of an organ outside of the scan."""

    summary = "empty"
