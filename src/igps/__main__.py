"""Entry point of `python -m igps`, which is the same as `igps`."""

from igps.cli import main

if __name__ == "__main__":
    main()
