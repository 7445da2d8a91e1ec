"""A pendulum simulated by MuJoCo feeds a virtual angle sensor, in real time, 200 lines a second.

teds-provision node create bench/angle --profile magnetic-angular-position-sensor
python examples/mujoco_pendulum.py | teds-provision node run bench/angle --can udp_multicast:239.74.163.2 --source -
"""

import json
import math
import time

import mujoco

MODEL = """<mujoco><option timestep="0.005"/><worldbody><body euler="0 60 0">
  <joint name="hinge" type="hinge" axis="0 1 0" damping="0.02"/><geom type="capsule" fromto="0 0 0 0 0 -.5" size=".02"/>
</body></worldbody><sensor><jointpos joint="hinge"/></sensor></mujoco>"""

model = mujoco.MjModel.from_xml_string(MODEL)
data = mujoco.MjData(model)
start = time.monotonic()
while True:
    mujoco.mj_step(model, data)
    angle = math.degrees(data.sensordata[0]) % 360
    print(json.dumps({"t": data.time, "value": {"angle": angle}}), flush=True)
    time.sleep(max(0.0, start + data.time - time.monotonic()))
