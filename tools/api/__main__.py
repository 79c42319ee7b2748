"""`python -m beamsplat`: the command line."""

from beamsplat.tools.cli.main import main

if __name__ == "__main__":
    main()
