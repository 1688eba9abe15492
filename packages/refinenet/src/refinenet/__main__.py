"""`python -m refinenet`, as torchrun starts it."""

from refinenet.cli import main

if __name__ == "__main__":
    main()
