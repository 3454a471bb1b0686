"""How fast the platform is beside hand-written C, PythonFMU and FMPy, all measured in one run."""
