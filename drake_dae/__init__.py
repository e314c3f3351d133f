"""Robots in contact as differential-algebraic systems in Drake.

Constrained robots as LeafSystems with the constraint force on an output port, and controllers that
track positions and contact forces at once, after Krishnan and McClamroch, "Tracking in nonlinear
differential-algebraic control systems with applications to constrained robot systems". Equation
numbers in the documentation are those of that paper.
"""

from importlib.metadata import version

from drake_dae.analysis.analyze import analyze
from drake_dae.analysis.report import Analysis
from drake_dae.dae.dynamic_extension import dynamic_extension
from drake_dae.dae.extension import Extension, extend
from drake_dae.dae.gains import FeedbackGains, gain_coefficients, gain_matrices, poles
from drake_dae.dae.normal_form import NormalForm
from drake_dae.dae.references import (
    ConstantReference,
    ExpressionReference,
    PointToPointReference,
    Reference,
    SinusoidReference,
)
from drake_dae.dae.signals import Parameter, Signal
from drake_dae.dae.structure import Structure, find_structure
from drake_dae.dae.system import DaeSystem
from drake_dae.dae.tracking import TrackingLaw
from drake_dae.dae.zero_dynamics.zero_dynamics import ZeroDynamics
from drake_dae.diagrams.build import build_scenario
from drake_dae.diagrams.closed_loop import ClosedLoop, make_closed_loop
from drake_dae.diagrams.scenario import load_scenario, scenario_schema
from drake_dae.errors import DrakeDaeError
from drake_dae.robots.actuation.dc_motors import DcMotors
from drake_dae.robots.actuation.flexible_joints import FlexibleJoints
from drake_dae.robots.actuation.hydraulics import ElectrohydraulicServos
from drake_dae.robots.contact.points import CoincidentPoints, PointOnSurface
from drake_dae.robots.contact.surfaces import (
    Cylinder,
    Ellipsoid,
    ImplicitSurface,
    Plane,
    Sphere,
    Torus,
)
from drake_dae.robots.contact.welds import WeldedFrames
from drake_dae.robots.links.multibody import MultibodyExpressions
from drake_dae.robots.links.textbook import LinkExpressions
from drake_dae.robots.model import RobotModel
from drake_dae.robots.outputs import (
    AxisCoordinates,
    ExpressionOutput,
    JointPositions,
    PointCoordinates,
    SurfaceCoordinates,
)
from drake_dae.simulation.animation import make_animation
from drake_dae.simulation.record import Record
from drake_dae.simulation.simulate import simulate
from drake_dae.simulation.view import start_meshcat
from drake_dae.symbolic import from_symbolic
from drake_dae.systems.controller import TrackingController
from drake_dae.systems.plant import DaePlant
from drake_dae.systems.realization import StateRealization
from drake_dae.systems.references import ReferenceGenerator, TrajectoryReference
from drake_dae.systems.robot_plant import RobotPlant
from drake_dae.systems.sensors import ForceSensor

__version__ = version("drake_dae")

__all__ = [
    "Analysis",
    "AxisCoordinates",
    "ClosedLoop",
    "CoincidentPoints",
    "ConstantReference",
    "Cylinder",
    "DaePlant",
    "DaeSystem",
    "DcMotors",
    "DrakeDaeError",
    "ElectrohydraulicServos",
    "Ellipsoid",
    "ExpressionOutput",
    "ExpressionReference",
    "Extension",
    "FeedbackGains",
    "FlexibleJoints",
    "ForceSensor",
    "ImplicitSurface",
    "JointPositions",
    "LinkExpressions",
    "MultibodyExpressions",
    "NormalForm",
    "Parameter",
    "Plane",
    "PointCoordinates",
    "PointOnSurface",
    "PointToPointReference",
    "Record",
    "Reference",
    "ReferenceGenerator",
    "RobotModel",
    "RobotPlant",
    "Signal",
    "SinusoidReference",
    "Sphere",
    "StateRealization",
    "Structure",
    "SurfaceCoordinates",
    "Torus",
    "TrackingController",
    "TrackingLaw",
    "TrajectoryReference",
    "WeldedFrames",
    "ZeroDynamics",
    "analyze",
    "build_scenario",
    "dynamic_extension",
    "extend",
    "find_structure",
    "from_symbolic",
    "gain_coefficients",
    "gain_matrices",
    "load_scenario",
    "make_animation",
    "make_closed_loop",
    "poles",
    "scenario_schema",
    "simulate",
    "start_meshcat",
]
