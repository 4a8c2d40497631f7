"""The policy of SROS2, its rules, and the topics and services that a node uses."""

import importlib.util
import xml.etree.ElementTree as ElementTree
from pathlib import Path

RIGHTS = ('publish', 'subscribe', 'reply', 'request')
SPEC = importlib.util.spec_from_file_location(
    'policy', Path(__file__).parents[1] / 'config' / 'sros2' / 'policy.py')
permissions = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(permissions)


def rules(text):
    """Return the allowed full names by right, for each path of an enclave."""
    found = {}
    for enclave in ElementTree.fromstring(text).iter('enclave'):
        (profile,) = enclave.iter('profile')
        space = profile.get('ns').rstrip('/')
        rights = {right: set() for right in RIGHTS}
        for group in profile:
            for right, rule in group.attrib.items():
                assert rule == 'ALLOW'
                for name in (element.text for element in group):
                    full = name.replace('~', f'{space}/{profile.get("node")}')
                    rights[right].add(full if full.startswith('/') else f'{space}/{full}')
        found[enclave.get('path')] = rights
    return found


def used(node, path):
    """Return the full names by right that the node at `path` uses, as `node` has discovered."""
    space, _, name = path.rpartition('/')
    space = space or '/'
    if (name, space) not in node.get_node_names_and_namespaces():
        return {right: set() for right in RIGHTS}
    found = {
        'publish': node.get_publisher_names_and_types_by_node(name, space),
        'subscribe': node.get_subscriber_names_and_types_by_node(name, space),
        'reply': node.get_service_names_and_types_by_node(name, space),
        'request': node.get_client_names_and_types_by_node(name, space)}
    return {right: {name for name, _ in pairs} for right, pairs in found.items()}
