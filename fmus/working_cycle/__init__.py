"""The equations of a working cycle in crank angle: gas, orifices, contents of volumes, cylinders and turbocharger."""
