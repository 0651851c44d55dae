"""The command `igps`. Outside of the package, so that Ctrl-C is heeded while the package and PyTorch are imported."""

import os
import signal


def main() -> None:
    """Run `igps.cli.main`."""
    usual = signal.getsignal(signal.SIGINT)
    if usual is signal.default_int_handler:  # else it is ignored, as by nohup. NumPy would swallow the exception
        signal.signal(signal.SIGINT, lambda *_: os._exit(130))  # as shells say it
    from igps.cli import main

    signal.signal(signal.SIGINT, usual)
    main()
