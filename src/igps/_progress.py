"""A bar on standard error that tells how far a long computation is."""

from typing import Any

from tqdm import tqdm


class Progress(tqdm):
    """A bar whose estimate leaves out the first result, and says that this one takes longer.

    Until then, worker processes start, and a new installation compiles its loops. This time says nothing about the
    results that follow.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self._is_first = not self.disable
        if self._is_first and self.n < self.total:
            self.set_postfix_str("the first takes longer")

    def update(self, n: float | None = 1) -> bool | None:
        """Add n results; the clock of the estimate starts at the first."""
        if not self._is_first:
            return super().update(n)
        self._is_first = False
        self.n += n or 0
        self.last_print_n = self.n
        self.unpause()
        self.set_postfix_str("")
        return True
