"""Files, command lines, pictures, plug-ins, random streams and threads: nothing of the subject."""
