"""Command-line tools for a network: demonstration, live view, recordings, topics, parameters."""

# Tools limit BLAS to one thread as nodes do, so that a replay reproduces results to the last bit.
import rhs_isac_ros.nodes  # noqa: F401
