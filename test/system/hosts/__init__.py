"""The network on several hosts of one machine: network namespaces whose links are pulled."""
