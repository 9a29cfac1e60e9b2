"""Add-on controllers of closed-loop machines: options, design, figures, page."""
