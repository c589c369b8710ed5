// What learner, replay-servers and actors say of themselves.

import { short } from "./chart.js";

function card(title, aside, facts, more = []) {
  const made = document.createElement("article");
  made.className = "card";
  const heading = document.createElement("h3");
  heading.textContent = title;
  const side = document.createElement("span");
  side.textContent = aside;
  heading.append(side);
  const list = document.createElement("dl");
  for (const [name, value] of facts) {
    const [term, fact] = [document.createElement("dt"), document.createElement("dd")];
    [term.textContent, fact.textContent] = [name, value];
    list.append(term, fact);
  }
  made.append(heading, ...more, list);
  return made;
}

function words(text) {
  const said = document.createElement("p");
  said.textContent = text;
  return said;
}

function learnerCard(learner) {
  if (!learner) return card("learner", "no answer", []);
  const bar = document.createElement("progress");
  [bar.max, bar.value] = [learner.total_updates || 1, learner.updates];
  bar.setAttribute("aria-label", "updates");
  return card("learner", learner.phase, [
    ["updates", `${short(learner.updates)} of ${short(learner.total_updates)}`],
    ["updates per second", learner.updates_per_s.toFixed(1)],
    ["environment frames", short(learner.env_frames)],
    ["frames per second", learner.env_frames_per_s.toFixed(0)],
    ["return, collecting", short(learner.collect_score)],
    ["return, evaluating", short(learner.evaluate_score)],
    ["time spent waiting for data", `${(100 * learner.wait_share).toFixed(0)}%`],
  ], [bar]);
}

function replayCard(replay) {
  if (!replay.up) return card(`replay ${replay.address}`, "no answer", []);
  const made = card("replay", replay.address, [
    ["steps held", short(replay.steps)],
    ["episodes held", short(replay.episodes)],
    ["on disk", `${(replay.bytes / 1e6).toFixed(0)} MB`],
    ["steps inserted", short(replay.inserted_steps)],
    ["steps sampled", short(replay.sampled_steps)],
  ]);
  if (replay.insert_waiting) made.append(words(`inserts wait: ${replay.insert_waiting}`));
  if (replay.sample_waiting) made.append(words(`draws wait: ${replay.sample_waiting}`));
  return made;
}

/** Shows an answer of `/api/live`. */
export function showLive(live) {
  document.getElementById("live-cards").replaceChildren(learnerCard(live.learner), ...live.replay.map(replayCard));
  const rows = (live.learner?.actors ?? []).map((actor) => {
    const row = document.createElement("tr");
    const cells = [
      actor.id,
      actor.evaluates ? "evaluates" : "collects",
      short(actor.episodes),
      short(actor.env_frames),
      short(actor.last_score),
      `${short(actor.policy_lag)} updates`,
    ];
    row.append(...cells.map((text) => {
      const cell = document.createElement("td");
      cell.textContent = text;
      return cell;
    }));
    return row;
  });
  document.querySelector("#actors tbody").replaceChildren(...rows);
}
