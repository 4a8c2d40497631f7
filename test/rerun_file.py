"""Reads what a view has written to a file, with the library that wrote it."""

import collections

import rerun


def read(path):
    """Return, for each path in the file, the components of each cycle by the name of their type.

    What is always shown is in cycle 0.
    """
    found = collections.defaultdict(dict)
    rows = _of_release_0_22(path) if hasattr(rerun, 'dataframe') else _of_chunks(path)
    for entity, cycle, name, values in rows:
        found[entity.lstrip('/')].setdefault(cycle, {})[name] = values
    return found


def _of_chunks(path):
    from rerun.chunk import RrdReader

    for chunk in RrdReader(path).stream():
        batch = chunk.to_record_batch()
        cycles = [0] * len(batch) if chunk.is_static else batch['cycle'].to_pylist()
        for field, column in zip(batch.schema, batch.columns, strict=True):
            kind = (field.metadata or {}).get(b'rerun:component_type', b'').rpartition(b'.')[2]
            for cycle, values in zip(cycles, column.to_pylist() if kind else (), strict=False):
                if values is not None:
                    yield chunk.entity_path, cycle, kind.decode(), values


def _of_release_0_22(path):
    recording = rerun.dataframe.load_recording(path)
    table = recording.view(index='cycle', contents='/**').select().read_all()
    cycles = table['cycle'].to_pylist()
    for column in recording.schema().component_columns():
        name = f'{column.entity_path}:{column.component_name.rpartition(".")[2]}'
        values = table[name].to_pylist() if name in table.column_names else ()
        kind = name.rpartition(':')[2].removeprefix('Pose')
        for cycle, value in zip(cycles, values, strict=False):
            # What is always shown is in each row.
            if value is not None:
                yield column.entity_path, 0 if column.is_static else cycle, kind, value
