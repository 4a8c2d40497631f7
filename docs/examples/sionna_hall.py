"""Trace a hall with Sionna RT, and measure the accuracy of the band plan in it.

The script needs ``pip install sionna-rt``. On a CPU, it also needs LLVM 16 or newer, with the path
of its library in ``DRJIT_LIBLLVM_PATH``. It writes the paths of random users to a file, surveys
the hall with the first 100 users, and locates the others:

    DRJIT_LIBLLVM_PATH=/usr/lib/x86_64-linux-gnu/libLLVM.so.19.1 \
        python3 docs/examples/sionna_hall.py hall_paths.npz

With ``--shelves``, the hall contains metal shelves, behind which some users have no direct path.
"""

import dataclasses
import sys
import tempfile
from pathlib import Path

import numpy as np

from rhs_isac_ros.calibration import survey, survey_report
from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import PathChannel, Scenario, simulate_received
from rhs_isac_ros.positioning import make_estimator
from rhs_isac_ros.support.optional import optional_import

CONFIG = Path(__file__).parents[2] / 'config'
F0_HZ = 2.75e9
N_SURVEY, N_TEST = 100, 300
# Squared Mahalanobis radius that contains 95 % of a Gaussian in three dimensions.
REGION_RADIUS = 7.815
# Number of users traced at a time; the tracer then needs less than 3 GB of memory.
BATCH = 20
# Centres and half sides of boxes [m]: a hall around the surface at the origin, and shelves.
HALL = ((9.95, 0.0, 0.5), (10.0, 7.0, 2.5))
SHELVES = tuple(((x, y, -0.7), (1.0, 0.25, 1.5)) for x, y in (
    (6.5, -2.5), (6.5, 2.5), (9.5, -4.0), (9.5, 3.8), (12.5, -1.5), (13.0, 2.0)))
MATERIAL = """<bsdf type="itu-radio-material" id="mat-{0}">
  <string name="type" value="{0}"/><float name="thickness" value="0.2"/>
</bsdf>"""
# A cube has sides of 2 m.
BOX = """<shape type="cube" id="elm-{0}">
  <transform name="to_world">
    <scale x="{1[0]}" y="{1[1]}" z="{1[2]}"/><translate x="{2[0]}" y="{2[1]}" z="{2[2]}"/>
  </transform>
  <ref id="mat-{3}" name="bsdf"/>
</shape>"""


def scene_of(shelves: tuple) -> str:
    """Return the description of the scene, a concrete hall with metal shelves, as XML."""
    shapes = [BOX.format(number, sides, centre, 'metal' if number else 'concrete')
              for number, (centre, sides) in enumerate((HALL, *shelves))]
    parts = [MATERIAL.format('concrete'), MATERIAL.format('metal'), *shapes]
    return f'<scene version="2.1.0">{"".join(parts)}</scene>'


def is_outside(users: np.ndarray, shelves: tuple) -> np.ndarray:
    """Return whether each user, at float64 [N, 3] [m], is outside of all shelves, bool [N]."""
    inside = [(np.abs(users - centre) < sides).all(axis=1) for centre, sides in shelves]
    return ~np.any(inside, axis=0) if shelves else np.ones(len(users), bool)


def trace(users: np.ndarray, shelves: tuple = ()) -> PathChannel:
    """Trace the paths of users, at float64 [N, 3] [m], with up to three specular reflections."""
    with optional_import('tracing a hall'):
        import sionna.rt as rt
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / 'hall.xml'
        file.write_text(scene_of(shelves), encoding='utf-8')
        scene = rt.load_scene(str(file), merge_shapes=False)
    scene.frequency = F0_HZ
    scene.tx_array = scene.rx_array = rt.PlanarArray(
        num_rows=1, num_cols=1, pattern='iso', polarization='V')
    scene.add(rt.Receiver('surface', position=[0.0, 0.0, 0.0]))
    solver, parts = rt.PathSolver(), []
    for start in range(0, len(users), BATCH):
        for name in list(scene.transmitters):
            scene.remove(name)
        for number, user in enumerate(users[start:start + BATCH].tolist()):
            scene.add(rt.Transmitter(f'user_{number}', position=user))
        paths = solver(scene, max_depth=3, samples_per_src=100_000, refraction=False)
        parts.append(PathChannel.from_sionna(paths, F0_HZ))
    return PathChannel.joined(parts)


def main(file: str, *options: str) -> None:
    """Trace the hall, survey it, locate the other users and print their errors."""
    shelves = SHELVES if '--shelves' in options else ()
    scenario = Scenario.from_yaml(CONFIG / 'bandplan.yaml')
    codebook = Codebook.load(CONFIG / 'codebook_bandplan.yaml')
    rng = np.random.default_rng(0)
    users = scenario.sample_positions(2 * (N_SURVEY + N_TEST), rng)
    users = users[is_outside(users, shelves)][:N_SURVEY + N_TEST]
    channel = trace(users, shelves)
    channel.save(file)
    received = simulate_received(
        dataclasses.replace(scenario, channel=channel), codebook, channel.users, rng)
    known, others = slice(N_SURVEY), slice(N_SURVEY, None)
    estimate = survey(scenario, codebook, channel.users[known], received[known])
    print(survey_report(estimate))
    in_sight = (channel.n[others] == 0).any(axis=1)
    for name, assumed in {
            'declared': scenario,
            'measured': dataclasses.replace(
                scenario, multipath=estimate, blocked_probability=0.1)}.items():
        fixes = make_estimator('bayes', assumed, codebook, reject_outside=True).estimate(
            received[others])
        errors = fixes.mean - channel.users[others]
        for group, chosen in {'in sight': in_sight, 'blocked': ~in_sight}.items():
            if not chosen.any():
                continue
            found = chosen & fixes.fix
            distances = np.einsum(
                'na,na->n', errors[found],
                np.linalg.solve(fixes.covariance[found], errors[found][..., None])[..., 0])
            rms_m = np.sqrt(np.mean(np.sum(errors[found]**2, axis=1))) if found.any() else np.nan
            print(f'{name}, {group}: {found.sum()} of {chosen.sum()} users with a fix, '
                  f'{np.sum(distances > REGION_RADIUS)} outside of their 95 % region, '
                  f'{rms_m:.2f} m rms')


if __name__ == '__main__':
    main(*sys.argv[1:])
