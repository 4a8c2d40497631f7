"""Trial of a network on several hosts: network namespaces whose links are taken down."""
