"""The last check: a reader of its own compares the written file with the original.

It shares no code with the interpreter, the planner or the writer, so that an error there cannot
hide from it; `pyproject.toml` has the contract. `rules` says what a firmware reads and skips,
`reader` follows one file line by line (`_reader_kernels` the plain lines), `comparing` follows
both files side by side while the second one is written.
"""
