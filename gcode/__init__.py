"""Text to motion and back: lexing, interpreting, planning, sampling, encoding.

`interpreter` turns lines into moves: the table of words is `firmware/NAME/dialect.py`, and what a
word does is `_command_kernels.execute`, or a handler in Python (`commands.py`, here and in
`firmware/NAME/`).
`firmware/NAME/planner.py` gives moves their times, `splitter` cuts them into pieces, `segments` and
`firmware/NAME/encoder.py` write motion as lines again.
"""
