"""One package per system of the literature: its scenario, its run, and a README with published figures beside ours."""
