"""Elements of the diagrams, whose style is in ``docs/_static/custom.css``."""

import html


def document(kind, title, width, height, parts):
    """Return an SVG document."""
    return (f'<svg xmlns="http://www.w3.org/2000/svg" class="diagram {kind}" width="{width:.0f}" '
            f'height="{height:.0f}" viewBox="0 0 {width:.0f} {height:.0f}" role="img">'
            f'<title>{title}</title>{"".join(parts)}</svg>')


def text(x, y, content, anchor='start', kind='label'):
    """Return a text; its anchor is start, middle or end."""
    return (f'<text class="{kind}" x="{x:.0f}" y="{y:.0f}" text-anchor="{anchor}">'
            f'{html.escape(content)}</text>')


def arrow(points):
    """Return a line along points (x, y) with horizontal and vertical parts, and its head."""
    path = 'M' + ' L'.join(f'{x:.0f} {y:.0f}' for x, y in points)
    (x0, y0), (x, y) = points[-2:]
    length = abs(x - x0) + abs(y - y0)
    dx, dy = (x - x0) / length, (y - y0) / length
    corners = [(x, y), *((x - 8 * dx + s * 4 * dy, y - 8 * dy + s * 4 * dx) for s in (1, -1))]
    head = ' '.join(f'{a:.0f},{b:.0f}' for a, b in corners)
    return f'<path d="{path}"/><polygon points="{head}"/>'
