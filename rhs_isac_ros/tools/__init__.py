"""Command-line tools for a network: demonstration, live view, recordings."""

# Like nodes, tools limit BLAS to one thread, so that a replay reproduces results bit for bit.
import rhs_isac_ros.nodes  # noqa: F401
