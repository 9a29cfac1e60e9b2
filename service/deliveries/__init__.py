"""What goes out by itself when a job is over: webhooks, and results to printers."""
