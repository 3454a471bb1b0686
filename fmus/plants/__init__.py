"""Built-in plants, one module each: equations, units, source, parameter sets by name."""
