"""Plants and observers in the shape of an FMU: modelling language, exporter, loader, plants."""
