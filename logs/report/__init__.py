"""Pages of flights: verdicts, plots, sentences."""
