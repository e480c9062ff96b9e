"""`python -m zerobev` is the command `zerobev`."""

from zerobev.cli import main

if __name__ == "__main__":
    main()
