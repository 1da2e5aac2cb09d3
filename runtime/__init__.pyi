# The public names, each with its home, once: a type checker reads them here, and `__init__.py` looks them up.
from .analysis.analysis import Analysis as Analysis
from .analysis.box_result import RobustStability as RobustStability
from .analysis.contact_modes import ContactModes as ContactModes
from .api import (
    absolute_stability as absolute_stability,
)
from .api import (
    analyze as analyze,
)
from .api import (
    analyze_many as analyze_many,
)
from .api import (
    arbitrary_switching as arbitrary_switching,
)
from .api import (
    bench as bench,
)
from .api import (
    changing_counts as changing_counts,
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
    critical as critical,
)
from .api import (
    event_order as event_order,
)
from .api import (
    export as export,
)
from .api import (
    fit as fit,
)
from .api import (
    fit_link as fit_link,
)
from .api import (
    limit_cycle as limit_cycle,
)
from .api import (
    load as load,
)
from .api import (
    margins as margins,
)
from .api import (
    mean_square_stability as mean_square_stability,
)
from .api import (
    operating_point as operating_point,
)
from .api import (
    paper_method as paper_method,
)
from .api import (
    parameters as parameters,
)
from .api import (
    pareto_front as pareto_front,
)
from .api import (
    region as region,
)
from .api import (
    report as report,
)
from .api import (
    robust_stability as robust_stability,
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
    transparency as transparency,
)
from .api import (
    tune as tune,
)
from .api import (
    with_hands as with_hands,
)
from .benchmark.speed_and_error import Bench as Bench
from .compiler.compiled import Model as Model
from .compiler.errors import ApcError as ApcError
from .extensions.changing_counts.joins_and_leaves import ChangingCounts as ChangingCounts
from .extensions.event_order.coincident_events import EventOrder as EventOrder
from .extensions.paper_method.lifted_matrices import PaperMethod as PaperMethod
from .extensions.parameter_fit.parameter_estimation import ParameterFit as ParameterFit
from .extensions.pareto_front.trade_off import Design as Design
from .extensions.pareto_front.trade_off import ParetoFront as ParetoFront
from .extensions.switching.arbitrary_switching import ArbitrarySwitching as ArbitrarySwitching
from .extensions.switching.limit_cycle import LimitCycle as LimitCycle
from .haptics.absolute_stability import AbsoluteStability as AbsoluteStability
from .haptics.frequency_response import Transparency as Transparency
from .lifting.rest_position import OperatingPoint as OperatingPoint
from .mean_square.mean_square_stability import MeanSquareStability as MeanSquareStability
from .network.link_fit import LinkFit as LinkFit
from .parameter_values.parameter_listing import Parameters as Parameters
from .regions.stable_region import Region as Region
from .reports.contents import Report as Report
from .simulation.trajectory import Trajectory as Trajectory
from .studies.batch_analysis import Analyses as Analyses
from .studies.comparison import SchemeComparison as SchemeComparison
from .studies.critical_values import Critical as Critical
from .studies.margins import Margins as Margins
from .studies.resumable_sweep import Sweep as Sweep
from .studies.sensitivity import Sensitivities as Sensitivities
from .tuning.tuner import Tuning as Tuning

__version__: str
