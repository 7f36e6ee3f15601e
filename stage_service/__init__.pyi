from .config import RigFile as RigFile
from .config import load_rig_file as load_rig_file
from .plan.capture_plan import CapturePlan as CapturePlan
from .plan.resolved import PlanError as PlanError
from .plan.resolved import ResolvedPlan as ResolvedPlan
from .plan.resolved import resolve as resolve
from .service import Service as Service
