"""Files, command lines, progress, pictures, plug-ins, random streams and threads."""
