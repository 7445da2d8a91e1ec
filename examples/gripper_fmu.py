"""A gripper as a functional mock-up unit (FMI 2.0); build it with: pythonfmu build -f examples/gripper_fmu.py."""

from pythonfmu import Fmi2Causality, Fmi2Slave, Real


class GripperFmu(Fmi2Slave):
    """Metres and newtons: the jaws follow their set point with 0.2 s, and meet a soft object of 20 mm."""

    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.target, self.opening, self.force = 0.0, 0.05, 0.0
        self.register_variable(Real("target", causality=Fmi2Causality.input))
        self.register_variable(Real("opening", causality=Fmi2Causality.output))
        self.register_variable(Real("force", causality=Fmi2Causality.output))

    def do_step(self, current_time, step_size):
        """Advance the model; the simulation's master calls it for each step."""
        self.opening += (self.target - self.opening) * step_size / 0.2
        self.force = max(0.0, 0.02 - self.opening) * 5000
        return True
