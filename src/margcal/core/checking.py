"""What a recording must be before anything is done with it: known units and time that runs forward."""
