"""An FMU is the gripper behind a virtual node: it gives opening and force, and obeys the node's actuator.

teds-provision node create bench/gripper --profile gripper
teds-provision node run bench/gripper --can udp_multicast:239.74.163.2 \
    --source "exec:python examples/fmu_gripper.py GripperFmu.fmu"
"""

import io
import json
import select
import sys
import time

from fmpy import extract, instantiate_fmu, read_model_description

model = read_model_description(sys.argv[1])
number = {variable.name: [variable.valueReference] for variable in model.modelVariables}
fmu = instantiate_fmu(extract(sys.argv[1]), model, fmi_type="CoSimulation")
fmu.setupExperiment(startTime=0.0)
fmu.enterInitializationMode()
fmu.exitInitializationMode()
orders = io.FileIO(0)
start, t, step = time.monotonic(), 0.0, 0.01
while True:
    while select.select([orders], [], [], 0)[0] and (line := orders.readline()):
        fmu.setReal(number["target"], [json.loads(line)["set"]["opening set point"]])
    fmu.doStep(currentCommunicationPoint=t, communicationStepSize=step)
    t += step
    value = {"opening": fmu.getReal(number["opening"])[0], "grip force": fmu.getReal(number["force"])[0]}
    print(json.dumps({"t": t, "value": value}), flush=True)
    time.sleep(max(0.0, start + t - time.monotonic()))
