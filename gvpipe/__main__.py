"""Run gvpipe as a module."""

from gvpipe.cli import main

if __name__ == "__main__":
    main()
