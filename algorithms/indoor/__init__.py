"""Indoor positioning from radio signal strength: ranging, trilateration, fingerprints, fusion with steps."""
