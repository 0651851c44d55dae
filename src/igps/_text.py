"""Counts in sentences."""


def counted(n: int, noun: str) -> str:
    """Return a number with its noun, in the plural unless it is one.

    Example:
        >>> counted(1, "voxel"), counted(1200, "body"), counted(0, "closed mesh")
        ('1 voxel', '1,200 bodies', '0 closed meshes')
    """
    return f"{n:,} {noun if n == 1 else _plural(noun)}"


def _plural(noun: str) -> str:
    if noun.endswith("vertex"):
        return noun.removesuffix("ex") + "ices"
    if noun.endswith("y"):
        return noun.removesuffix("y") + "ies"
    if noun.endswith(("s", "sh", "ch", "x")):
        return noun + "es"
    return noun + "s"
