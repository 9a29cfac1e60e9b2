"""`python -m stillpath`, for where the program itself is not on the PATH."""

from stillpath.cli.main import main

__all__: list[str] = []

if __name__ == "__main__":
    main()
