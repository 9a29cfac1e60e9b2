"""Deliveries after a job: webhooks, and results to printers."""
