"""Text to motion and back: lexing, interpreting, planning, sampling, encoding."""
