"""Actuation: a chain of stages between the control and the joints."""

from drake_dae.robots.actuation.dc_motors import DcMotors
from drake_dae.robots.actuation.flexible_joints import FlexibleJoints
from drake_dae.robots.actuation.hydraulics import ElectrohydraulicServos
from drake_dae.robots.actuation.stage import Stage

__all__ = ["DcMotors", "ElectrohydraulicServos", "FlexibleJoints", "Stage"]
