// Generated from orchestrator/watch/dashboard/messages.py by `make types`: do not edit.

/** What can be done with a run now, why nothing can, and the last line of a driver that failed. */
export interface Actions {
  allowed: boolean;
  why: string | null;
  available: Array<string>;
  failed: string | null;
}

/** A camera that trains a block, and which criterion chose it. */
export interface BlockCamera {
  row: number;
  name: string;
  reason: "geometry" | "gradient" | "both";
}

/** GET …/block/{number}: the cameras that train a block. */
export interface BlockCameras {
  block: number;
  cameras: Array<BlockCamera>;
}

/** One block of the plan: what it weighs and whether it is trained at all. */
export interface BlockPlan {
  block: number;
  cameras: number;
  gaussians: number;
  train: boolean;
}

/** GET …/camera/{row}: a training panorama of the plan. */
export interface CameraView {
  row: number;
  name: string;
  block: number;
  scores: Array<number>;
  assigned: Record<string, "geometry" | "gradient" | "both">;
  no_picture: string | null;
}

/** A run of a comparison; where it cannot be read, `error` says why, and all that follows is missing. */
export interface ComparedRun {
  id: string;
  name: string;
  color: string;
  error: string | null;
  path: string;
  status: string;
  label: string;
  stage: string;
  progress: number;
  scene: string | null;
  fingerprint: string | null;
  version: string | null;
  recipe: string | null;
  width: number | null;
  stage_one: Trained | null;
  blocks: number | null;
  blocks_done: number | null;
  stage_two: Trained | null;
  gaussians: number | null;
  bytes: number | null;
  seconds: number | null;
  stages: Array<StageTime>;
  memory: number | null;
  gpu_memory: number | null;
  machines: Array<string>;
  measured: MeasuredView | null;
  metrics: Record<string, MetricView>;
}

/** A held-out panorama: its metrics and its picture in each run. */
export interface ComparedView {
  name: string;
  metrics: Array<Record<string, number | null> | null>;
  pictures: Array<string | null>;
  truth: string | null;
}

/** Runs side by side. `first` is the index of the run that the others are compared with. */
export interface Comparison {
  first: number;
  runs: Array<ComparedRun>;
  warnings: Array<string>;
  settings: Array<DifferentSetting>;
  more_settings: number;
  views: Array<ComparedView>;
  more_views: number;
}

/** A value over the iterations of a run, its stages one after the other, and over its minutes. */
export interface Curve {
  iterations: Line;
  minutes: Line;
}

/** The curves of the runs of a comparison, in their order. */
export interface CurvesOfRuns {
  runs: Array<RunCurves>;
}

/** How far what the two blocks show differs. */
export interface Difference {
  color: number | null;
  psnr: number | null;
  depth: number | null;
  opacity: number | null;
}

/** A setting that is not the same in all runs; `known` is false where a run's version does not have it. */
export interface DifferentSetting {
  key: string;
  values: Array<any>;
  known: Array<boolean>;
  doc: string;
}

/** GET …/events and the stream's "events": newest first. To continue: `before` = `next`. */
export interface EventList {
  events: Array<RunEvent>;
  more: boolean;
  next: number | null;
}

/** GET …/exposure: at most 600 of the panoramas in order, in stops over the mean; also of each channel. */
export interface ExposureCurve {
  name: Array<string>;
  stops: Array<number>;
  red: Array<number>;
  green: Array<number>;
  blue: Array<number>;
}

/** GET …/findings: the worst first, `colors` of the seams; `pictures` are names for …/findings/{name}. */
export interface Findings {
  metrics: HeldOutMetrics | null;
  seams: Array<Seam>;
  colors: Array<string | null>;
  moves: Array<MovedCamera>;
  movers: Array<MoverShare>;
  pictures: Array<string>;
}

/** What one GPU does; None where nvidia-smi does not know it. */
export interface GpuUsage {
  name: string;
  utilization: number | null;
  memory_used: number | null;
  memory_total: number | null;
}

/** The metrics of held-out panoramas, and their means; `lpips_reason`, why there is no LPIPS. */
export interface HeldOutMetrics {
  mean: Record<string, number | null>;
  views: Record<string, Record<string, number | null>>;
  pose_fit: PoseFit | null;
  lpips_reason: string | null;
  unmeasured: string | null;
}

/** A held-out panorama with its metrics. */
export interface HeldOutView {
  number: number;
  name: string;
  metrics: Record<string, number | null> | null;
}

/** GET …/views. */
export interface HeldOutViews {
  views: Array<HeldOutView>;
}

/** Why a node leaves. */
export type Leaving = "preemption" | "termination" | "maintenance" | "rebalance" | "drain";

/** A machine that has announced that it leaves; `until` in epoch seconds, None if it is not known when. */
export interface LeavingView {
  node: string;
  host: string;
  kind: Leaving;
  reason: string;
  until: number | null;
}

/** The points of a curve. */
export interface Line {
  x: Array<number>;
  y: Array<number | null>;
}

/** All machines of one kind; `there` counts those that are there now, `price` is per hour. */
export interface MachineKindView {
  kind: string;
  price: number | null;
  count: number;
  there: number;
  used: UsedView;
  idle: UsedView;
  lost: UsedView;
}

/** How the metrics of a run were measured: what metrics.json says besides the metrics. */
export interface MeasuredView {
  width: number | null;
  crop_bottom: number | null;
  detail: number | null;
  panoramas: number;
  left_out: number;
  gaussians: number | null;
}

/** A metric of a run: its mean over the held-out panoramas, and compared with the first run. */
export interface MetricView {
  mean: number | null;
  difference: number | null;
  panoramas: number | null;
  better: number | null;
  worse: number | null;
}

/** The merged model. */
export interface ModelView {
  path: string;
  gaussians: number;
  bytes: number;
}

/** The account of a run: all that was reserved, and what of it was idle or had to be done again. */
export interface MoneyView {
  currency: string;
  used: UsedView;
  idle: UsedView;
  lost: UsedView;
  rate: number | null;
  max_cost: number | null;
  deadline: number | null;
  reached: string | null;
  kinds: Array<MachineKindView>;
}

/** A refined camera: how far it moved in world units, turned in degrees, and moved what it sees. */
export interface MovedCamera {
  name: string;
  moved: number;
  turned: number;
  pixels: number;
  at_bound: boolean;
}

/** Bytes between machines. */
export interface MovedView {
  received: number;
  sent: number;
}

/** A training panorama, and what part of it is left out of the loss because it moves, 0 to 1. */
export interface MoverShare {
  name: string;
  share: number;
}

/** A machine that tasks have run on, and what runs there now. */
export interface NodeView {
  node: string;
  tasks: Array<string>;
  gpus: Array<string>;
  device: string;
  memory: number;
  rate: number;
  usage: UsageView | null;
  quarantine: QuarantineView | null;
  leaving: LeavingView | null;
}

/** What a user should read. */
export interface NoticeView {
  task: string;
  message: string;
}

/** A picture of what a step has made; `version` changes with it. */
export interface PictureView {
  name: string;
  label: string;
  version: string;
}

/** Metrics of held-out panoramas at the poses that fit the model best, `pixels` away on average. */
export interface PoseFit {
  mean: Record<string, number | null>;
}

/** The preparation of a run; the counts are None before there are poses. */
export interface PreparationView {
  source: string;
  others: Array<string>;
  video: boolean;
  frames: number;
  panoramas: number | null;
  registered: number | null;
  points: number | null;
  weak_links: number | null;
  contradictions: number | null;
  latest: number | null;
  progress: number;
  over: number;
  steps: Array<StepView>;
  pictures: Array<PictureView>;
}

/** GET …/previews. */
export interface PreviewList {
  previews: Array<SavedPreview>;
}

/** A machine on which nothing is placed; `until` in epoch seconds. */
export interface QuarantineView {
  node: string;
  host: string;
  state: "quarantined";
  reason: string;
  until: number;
}

/** The queue: those that run, those that wait in order, and the latest that have ended. */
export interface QueueList {
  folder: string;
  runner: boolean;
  hidden: number;
  entries: Array<QueueRow>;
  error: string | null;
}

/** An entry of the queue. `run` is the id of its run, if that is below the dashboard's folder. */
export interface QueueRow {
  id: number;
  name: string;
  run: string | null;
  state: string;
  label: string;
  reason: string;
  share: string;
  time: number;
}

/** Error and step of one model at a face, those within the blocks (floor), and the ratios of both. */
export interface Ratios {
  error: number | null;
  error_floor: number | null;
  error_ratio: number | null;
  step: number | null;
  step_floor: number | null;
  step_ratio: number | null;
}

/** Which results of a run can be downloaded. */
export interface Results {
  model: boolean;
  report: boolean;
  view: boolean;
  sog: boolean;
  in_3d: boolean;
  map: boolean;
  outline: string | null;
  exposure: string | null;
  findings: string;
}

/** The stream's "changes": what has changed since the last message; of the tasks those that have. */
export interface RunChanges {
  now: number;
  latest: number | null;
  progress: number;
  eta: number | null;
  paused: Array<number>;
  stages: Array<StageView>;
  nodes: Array<NodeView>;
  preparation: PreparationView | null;
  store: string;
  id: string;
  actions: Actions;
  result: Results;
  summary: SummaryHead;
  tasks: Array<TaskView>;
}

/** The curves of a run, by its stages; `error` says why there are none. */
export interface RunCurves {
  id: string;
  stages: Array<StageCurves>;
  error: string | null;
}

/** A record of a run, with the fields of its type. */
export interface RunEvent {
  id: number;
  time: number;
  type: string;
  task: string;
  [name: string]: any;
}

/** GET /api/runs and the stream's "runs": newest first. `queue` is null where there is none. */
export interface RunList {
  folder: string;
  runs: Array<RunRow>;
  queue: QueueList | null;
}

/** GET /api/runs/{id} and the stream's "run". */
export interface RunPage {
  now: number;
  latest: number | null;
  progress: number;
  eta: number | null;
  paused: Array<number>;
  stages: Array<StageView>;
  nodes: Array<NodeView>;
  preparation: PreparationView | null;
  store: string;
  info: Record<string, any>;
  summary: Summary;
  began: number | null;
  config: Array<SettingView>;
  id: string;
  name: string;
  path: string;
  actions: Actions;
  result: Results;
}

/** A run in the list: `status` also "unread" or "unreadable"; `created` and `latest` in epoch seconds. */
export interface RunRow {
  id: string;
  name: string;
  status: string;
  label: string;
  scene: string | null;
  stage: string | null;
  stage_label: string;
  progress: number;
  eta: number | null;
  psnr: number | null;
  gaussians: number | null;
  size: number | null;
  created: number | null;
  latest: number | null;
  seconds: number | null;
  width: number | null;
  iterations: number | null;
  blocks: number | null;
  cover: number | null;
  error: string | null;
}

/** A render of a panorama, above the photograph. */
export interface SavedPreview {
  event: number;
  task: string;
  iteration: number;
  view: string;
  time: number;
  held_out: boolean;
}

/** A face between two blocks, see `workers.seams.measurement`. */
export interface Seam {
  blocks: [number, number];
  axis: "x" | "y" | "z";
  at: number;
  cameras: Array<string>;
  virtual: number;
  seam: number | null;
  merged: Ratios;
  coarse: Ratios;
  difference: Difference;
}

/** A curve: iterations, epoch seconds, values. GET …/series has one for each name. */
export interface Series {
  iteration: Array<number>;
  time: Array<number>;
  value: Array<number | null>;
}

/** A setting of a run next to its default. */
export interface SettingView {
  key: string;
  value: any;
  default: any;
  changed: boolean;
  unit_or_doc: string;
}

/** The curves of a stage: the mean of its tasks, of Gaussians the sum. `read` of `tasks` are in it. */
export interface StageCurves {
  stage: string;
  label: string;
  tasks: number;
  read: number;
  curves: Record<string, Curve>;
}

/** A stage of a run, with the seconds in which a driver was at work on it. */
export interface StageTime {
  name: string;
  label: string;
  seconds: number | null;
}

/** A stage of a run; `began` and `ended` in epoch seconds, `seconds` those in which a driver was at work. */
export interface StageView {
  name: string;
  label: string;
  status: Status | "stopped";
  began: number | null;
  ended: number | null;
  seconds: number | null;
  progress: number;
  tasks: number;
  done: number;
}

/** How a task stands. */
export type Status = "waiting" | "paused" | "running" | "done" | "failed";

/** A step; `done` of `total` of `what` while it runs, a `total` of 0 is not known. */
export interface StepView {
  name: string;
  label: string;
  status: "waiting" | "running" | "stopped" | "done";
  what: string;
  done: number;
  total: number;
  seconds: number | null;
  lines: Array<string>;
}

/** The state of a run: what `panolog status --json` prints. */
export interface Summary {
  status: string;
  label: string;
  stage: string;
  step: string | null;
  reason: string | null;
  waiting: string;
  resume: string | null;
  progress: number;
  seconds: number | null;
  eta: number | null;
  paused: Array<number>;
  training_gaussians: number | null;
  kept_gaussians: number | null;
  model: ModelView | null;
  metrics: Record<string, number | null> | null;
  moved: MovedView;
  notices: Array<NoticeView>;
  quarantined: Array<QuarantineView>;
  leaving: Array<LeavingView>;
  money: MoneyView | null;
  tasks: Array<TaskView>;
  blocks: Array<BlockPlan>;
}

/** The state of a run but for its tasks and blocks. */
export interface SummaryHead {
  status: string;
  label: string;
  stage: string;
  step: string | null;
  reason: string | null;
  waiting: string;
  resume: string | null;
  progress: number;
  seconds: number | null;
  eta: number | null;
  paused: Array<number>;
  training_gaussians: number | null;
  kept_gaussians: number | null;
  model: ModelView | null;
  metrics: Record<string, number | null> | null;
  moved: MovedView;
  notices: Array<NoticeView>;
  quarantined: Array<QuarantineView>;
  leaving: Array<LeavingView>;
  money: MoneyView | null;
}

/** A task: its progress, where it runs, and what went wrong; `seconds` of all its attempts. */
export interface TaskView {
  name: string;
  status: Status;
  share: number;
  iteration: number | null;
  iterations: number | null;
  rate: number | null;
  eta: number | null;
  loss: number | null;
  psnr: number | null;
  gaussians: number | null;
  memory: number | null;
  host_peak: number | null;
  seconds: number | null;
  checkpoint: number | null;
  node: string | null;
  received: number;
  sent: number;
  retries: number;
  moves: number;
  reasons: Array<string>;
}

/** Iterations of all tasks of a kind: done and in all. */
export interface Trained {
  iteration: number;
  iterations: number;
}

/** What a machine does, measured at `time` in epoch seconds: `cpu` 0 to 1, the disk that the run uses. */
export interface UsageView {
  time: number;
  cpu: number;
  memory_used: number;
  memory_total: number;
  disk_used: number;
  disk_total: number;
  gpus: Array<GpuUsage>;
}

/** Seconds of machines, and their cost; None where no price is known. */
export interface UsedView {
  seconds: number;
  cost: number | null;
}
