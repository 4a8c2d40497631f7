"""From an empty hall, traced with Sionna RT, to the accuracy of the band plan in it.

The script needs ``pip install sionna-rt`` and, on a CPU, LLVM 16 or newer, whose library
``DRJIT_LIBLLVM_PATH`` names. It writes the paths of random users, surveys the hall with the first
100 of them, and locates the others:

    DRJIT_LIBLLVM_PATH=/usr/lib/x86_64-linux-gnu/libLLVM.so.19.1 \
        python3 docs/examples/sionna_hall.py hall_paths.npz
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
N_SURVEY, N_TEST = 100, 100
# Users that are traced together, for which the tracer needs less than 3 GB of memory.
BATCH = 20
# A box of 20 x 14 x 5 m around the surface at the origin; a cube has sides of 2 m.
HALL = """<scene version="2.1.0">
  <bsdf type="itu-radio-material" id="mat-hall">
    <string name="type" value="concrete"/><float name="thickness" value="0.3"/>
  </bsdf>
  <shape type="cube" id="elm-hall">
    <transform name="to_world">
      <scale x="10" y="7" z="2.5"/><translate x="9.95" y="0" z="0.5"/>
    </transform>
    <ref id="mat-hall" name="bsdf"/>
  </shape>
</scene>"""


def trace(users: np.ndarray) -> PathChannel:
    """Return the paths of users, float64 [N, 3] [m], with up to three specular reflections."""
    with optional_import('tracing a hall'):
        import sionna.rt as rt
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / 'hall.xml'
        file.write_text(HALL, encoding='utf-8')
        scene = rt.load_scene(str(file))
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


def main(file: str) -> None:
    """Trace the hall, survey it and locate users."""
    scenario = Scenario.from_yaml(CONFIG / 'bandplan.yaml')
    codebook = Codebook.load(CONFIG / 'codebook_bandplan.yaml')
    rng = np.random.default_rng(0)
    channel = trace(scenario.sample_positions(N_SURVEY + N_TEST, rng))
    channel.save(file)
    received = simulate_received(
        dataclasses.replace(scenario, channel=channel), codebook, channel.users, rng)
    known, others = slice(N_SURVEY), slice(N_SURVEY, None)
    estimate = survey(scenario, codebook, channel.users[known], received[known])
    print(survey_report(estimate))
    for name, assumed in {
            'declared': scenario,
            'measured': dataclasses.replace(scenario, multipath=estimate)}.items():
        fixes = make_estimator('bayes', assumed, codebook, reject_outside=True).estimate(
            received[others])
        errors = np.linalg.norm(fixes.mean - channel.users[others], axis=1)[fixes.fix]
        print(f'{name}: {fixes.fix.sum()} of {N_TEST} users with a fix, '
              f'{np.sqrt(np.mean(errors**2)):.2f} m rms')


if __name__ == '__main__':
    main(*sys.argv[1:])
