# # A robot in contact, from its file to its animation
#
# A notebook that is kept as a script: VS Code shows "Run Cell" above each `# %%`, PyCharm and
# Spyder do as well, and Jupyter opens it with the extension Jupytext (Open With > Notebook). It
# also runs as it is: `python notebook_first_contact.py`.

# %% A scenario is a robot, what it touches, what it shall do, and how to simulate it.
from drake_dae import analyze, build_scenario, load_scenario, make_animation, simulate

scenario = load_scenario("two_link_wall", ["duration=3"])
scenario

# %% Its closed loop: the arm, what it shall follow, and the law, wired as a Drake diagram.
loop, context = build_scenario(scenario)
loop.plant.model

# %% What the theory says before anything runs: degrees, index, and how far all is from singular.
report = analyze(loop.plant.dae)
report

# %% It runs, and leaves a record of all signals with their names and units.
statistics = simulate(loop.diagram, context, scenario.duration, scenario.integrator)
record = loop.record(context)
record

# %% Position and contact force follow their references at once; the start was 5 cm off.
frame = record.to_dataframe()
frame["controlled_output"].iloc[[0, -1]]

# %% The errors are known beforehand: they decay by the gains alone.
predicted = loop.predicted_error(record)
off = abs(record["tracking_error"] - predicted).max()
print(f"errors are off the predicted ones by {off:.1e} at most")

# %% What it looks like: turn it with the mouse.
page = make_animation(loop, record, context, "A two-link arm on a wall")
page
