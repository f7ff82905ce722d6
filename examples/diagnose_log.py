"""Say what the simulation gets wrong about measured balls: python examples/diagnose_log.py balls.csv"""

import sys

import mjx_tt

mjx_tt.configure(devices=1)
logs = mjx_tt.load_logs(sys.argv[1:])  # session,trajectory,t,x,y,z; folders with joint logs; sessions at the robot
found = mjx_tt.diagnose(logs, mjx_tt.SimModel())

print(found.verdict.verdict)
for cause in found.verdict.causes:
    for path, estimate in cause.parameters.items():
        print(f"  {path}: {estimate.nominal:g} -> {estimate.estimate:g} ({estimate.low:g} to {estimate.high:g})")
mjx_tt.write_report("diagnosis", found, title=", ".join(sys.argv[1:]))
found.extended.save("diagnosis/extended.yaml")
