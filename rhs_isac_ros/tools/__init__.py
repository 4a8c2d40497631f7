"""Command-line tools for a network: demonstration, live view, recordings, topics, parameters."""
