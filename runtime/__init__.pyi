# The public names, each with its home, once: a type checker reads them here, and `__init__.py` looks them up.
from .analysis.analysis import Analysis as Analysis
from .analysis.box_proof import RobustStability as RobustStability
from .analysis.contact_modes import ContactModes as ContactModes
from .analysis.conventions import EventOrder as EventOrder
from .analysis.paper import PaperMethod as PaperMethod
from .analysis.switching import ArbitrarySwitching as ArbitrarySwitching
from .api import (
    analyze as analyze,
)
from .api import (
    analyze_many as analyze_many,
)
from .api import (
    bench as bench,
)
from .api import (
    buzz as buzz,
)
from .api import (
    compare as compare,
)
from .api import (
    compile as compile,
)
from .api import (
    contact_modes as contact_modes,
)
from .api import (
    conventions as conventions,
)
from .api import (
    critical as critical,
)
from .api import (
    describe_network as describe_network,
)
from .api import (
    export as export,
)
from .api import (
    feel as feel,
)
from .api import (
    front as front,
)
from .api import (
    judge_network as judge_network,
)
from .api import (
    load as load,
)
from .api import (
    margins as margins,
)
from .api import (
    paper_route as paper_route,
)
from .api import (
    parameters as parameters,
)
from .api import (
    passive_hands as passive_hands,
)
from .api import (
    prove_box as prove_box,
)
from .api import (
    region as region,
)
from .api import (
    report as report,
)
from .api import (
    save as save,
)
from .api import (
    schema as schema,
)
from .api import (
    sensitivities as sensitivities,
)
from .api import (
    set_parameters as set_parameters,
)
from .api import (
    show as show,
)
from .api import (
    simulate as simulate,
)
from .api import (
    sweep as sweep,
)
from .api import (
    switching as switching,
)
from .api import (
    tune as tune,
)
from .api import (
    with_hands as with_hands,
)
from .benchmark.speed_and_error import Bench as Bench
from .comparison.comparison import SchemeComparison as SchemeComparison
from .compiler.compiled import Model as Model
from .compiler.errors import ApcError as ApcError
from .frame.settable import Parameters as Parameters
from .hands.frequency_response import Transparency as Transparency
from .hands.passivity import AbsoluteStability as AbsoluteStability
from .moments.network_verdict import MeanSquareStability as MeanSquareStability
from .network.recorded import LinkFit as LinkFit
from .regions.stable_region import Region as Region
from .reports.contents import Report as Report
from .simulation.buzz import LimitCycle as LimitCycle
from .simulation.trajectory import Trajectory as Trajectory
from .sweeps.resumable_sweep import Sweep as Sweep
from .tuning.front import Design as Design
from .tuning.front import ParetoFront as ParetoFront
from .tuning.tuner import Tuning as Tuning
from .vary.critical_values import Critical as Critical
from .vary.many import Analyses as Analyses
from .vary.margins import Margins as Margins
from .vary.sensitivity import Sensitivities as Sensitivities

__version__: str
