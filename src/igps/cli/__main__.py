"""`python -m igps.cli` is `igps`."""

from igps.cli import main

if __name__ == "__main__":
    main()
