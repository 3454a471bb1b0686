"""Built-in controllers, one module each: control law, units, source, where it is stable."""
