"""The fixed C sources that every exported FMU is built from."""
