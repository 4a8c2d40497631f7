"""Shared helpers: files, command lines, fields, plug-ins, pictures, streams and threads."""
