"""A command's wall and processor seconds, peak memory of its largest process, exit code and output, as JSON.

Started anew for each measurement: what a child is said to take at its most is never less than its parent has.
"""

import json
import resource
import subprocess
import sys
import time

began = time.perf_counter()
done = subprocess.run(sys.argv[1:], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, check=False)
seconds = time.perf_counter() - began
used = resource.getrusage(resource.RUSAGE_CHILDREN)
cpu_s, mib = used.ru_utime + used.ru_stime, used.ru_maxrss / 1024
print(
    json.dumps(
        {"seconds": seconds, "cpu_s": cpu_s, "mib": mib, "code": done.returncode, "output": done.stdout}
    )
)
