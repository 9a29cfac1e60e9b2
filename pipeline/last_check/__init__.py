"""The last check: an independent reader compares the written file with the original.

It shares no code with the interpreter, the planner or the writer, so that an error there cannot
hide from it; `pyproject.toml` has the contract. `rules` says what a firmware reads and skips,
`reader` follows one file line by line (plain lines in `_reader_kernels`), and `comparing` follows
both files in parallel while the second one is written.
"""
