"""The Unitree Go2 as data: constants, model, kinematics and features."""
