"""Test of the network on several hosts: network namespaces whose links are taken down."""
