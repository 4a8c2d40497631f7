"""Detection of positions in several frames."""

# Time for which the frame of a position counts [s].
WINDOW_S = 10.0
# Maximum number of frames that are compared, because they come from messages; and of characters.
_MAX_FRAMES, _MAX_LENGTH = 8, 100


class FrameWatch:
    """Compares the frames of received positions; times `now_s` [s] are on a steady clock.

    `own` is the frame in which the node expects and publishes positions; empty if it has none.
    """

    def __init__(self, own: str = '') -> None:
        self._own = own
        # Topic and time of the latest position in each frame.
        self._seen: dict[str, tuple[str, float]] = {}

    def add(self, topic: str, frame: str, now_s: float) -> None:
        """Process a position in a frame, which is unknown if it is empty."""
        if frame and (frame in self._seen or len(self._seen) < _MAX_FRAMES):
            self._seen[frame] = topic, now_s

    def update(self, now_s: float) -> str:
        """Return a description of the frames if there are several, or ''."""
        self._seen = {frame: seen for frame, seen in self._seen.items()
                      if now_s < seen[1] + WINDOW_S}
        found = {frame: topic for frame, (topic, _) in sorted(self._seen.items())}
        if self._own:
            found = {self._own: 'this node', **{
                frame: topic for frame, topic in found.items() if frame != self._own}}
        if len(found) < 2:
            return ''
        texts = (f'{frame[:_MAX_LENGTH]!r} ({topic})' for frame, topic in found.items())
        return (f'positions in the frames {", ".join(texts)}, but coordinates are not '
                'transformed: expected the same frame_id in all nodes')
