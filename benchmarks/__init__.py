"""How fast the platform is beside hand-written C, PythonFMU, FMPy, ecos and libcosim, all measured in one run."""
