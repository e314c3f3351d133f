# # Tracking for a differential-algebraic system, step by step
#
# A notebook that is kept as a script: VS Code shows "Run Cell" above each `# %%`, PyCharm and
# Spyder do as well, and Jupyter opens it with the extension Jupytext (Open With > Notebook). It
# also runs as it is: `python notebook_theory.py`.
#
# A bead of 1 kg slides on a hoop of 1 m, which is a constraint; u pushes it along x. Numbers in
# brackets are those of the paper's equations.

# %% (1)-(3): the equations, with the hoop's force v as an unknown of its own.
import numpy as np
from pydrake.systems.analysis import SimulatorConfig

import drake_dae as dd

bead = dd.DaeSystem.from_functions(
    ["x", "z", "vx", "vz"],
    f=lambda s: [s[2], s[3], 0.0, -9.81],
    g=lambda s: [0.0, 0.0, s[0], s[1]],
    h=lambda s: [0.0, 0.0, 1.0, 0.0],
    k=lambda s: [(s[0] ** 2 + s[1] ** 2 - 1.0) / 2.0],
    l=lambda s: [s[0]],
    m=lambda s: [[0.0]],
    nominal_state=[0.0, -1.0, 0.0, 0.0],
    name="bead",
)
bead

# %% Assumptions (1)-(5), relative degrees and the index, which is three: a mechanism.
report = dd.analyze(bead)
report

# %% (4): states that fit the constraint, and are the only ones that the bead can have.
manifold = report.structure.manifold
start = manifold.project([0.3, -0.9, 0.0, 0.0])
start

# %% (20)-(22): in the coordinates of the normal form two are zero, and two are a double integrator.
form = dd.NormalForm(bead, structure=report.structure)
form.coordinates(start)

# %% (28): the law, and (30): the error that it leaves.
law = dd.TrackingLaw(bead, dd.poles(-4.0), structure=report.structure)
law

# %% In Drake: a plant, a controller and a reference, wired and run.
loop = dd.make_closed_loop(
    dd.DaePlant(bead, structure=report.structure), law, [dd.SinusoidReference(0.0, 0.5, 2.0)]
)
context = loop.diagram.CreateDefaultContext()
loop.plant.set_consistent_state(loop.plant.GetMyMutableContextFromRoot(context), start)
config = SimulatorConfig(integration_scheme="runge_kutta5", accuracy=1e-9)
dd.simulate(loop.diagram, context, 3.0, config)
record = loop.record(context)
record

# %% The bead stays on the hoop, its error is the predicted one, and the hoop's force is known.
hoop = np.abs(np.linalg.norm(record["state"][:, :2], axis=1) - 1.0).max()
off = np.abs(record["tracking_error"] - loop.predicted_error(record)).max()
print(f"off the hoop by {hoop:.1e} m, off the predicted error by {off:.1e} m")
print(f"the hoop pulls with up to {-record['constraint_force'].min():.1f} N")
